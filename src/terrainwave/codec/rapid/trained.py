"""Tables of the `rapid` method: written by tools/train_rapid.py, never edited.

Stencils by plane (HH, HL, LH) and set, in 1/4096; weights of the expected magnitude by table, class
of levels and plane or line, in 2**-24; codes of frequencies by family, context and symbol.
"""

# fmt: off
import base64
import zlib
from functools import cache

import numpy as np
from numpy.typing import NDArray

STENCILS = {
    1: np.array([[76, -12, -39, 57, -37, 1576, 1535, -80, -189, 1310, 1294, -200, 14, -165, -179, 42, -367, -278, -262], [28, -28, -7, -39, 43, 1144, 1295, -32, -61, 1150, 1086, -8, -34, -21, -51, -54, -191, -54, -70], [60, 36, 105, 57, -53, 1704, 1743, -16, -205, 1294, 1278, -248, 30, -165, -179, 42, -367, -614, -406], [44, -76, 137, 57, -293, 1784, 1247, -176, -125, 1054, 1678, -360, 62, -213, -179, 74, 33, -406, -246], [116, 108, 53, 137, -133, 1880, 1923, -28, -237, 1318, 1258, -312, 62, -205, -199, 102, -483, -702, -562], [68, -104, -75, 81, -117, 1416, 1271, -48, -157, 1258, 1414, -212, 14, -121, -179, 34, -291, 170, -326], [-8, 42, 29, -16, 13, 1103, 1097, -1, -59, 1042, 1127, -67, 2, 17, -39, -17, -108, -10, -51], [36, 140, 49, 25, -125, 1768, 1735, -64, -197, 1278, 1142, -200, 14, -109, -171, 58, -279, -766, -238], [220, -100, -159, -23, -261, 1296, 1407, -96, -69, 1334, 1102, -248, -66, 35, -211, 122, -375, 354, -166], [24, 20, -43, -3, 35, 1148, 1119, 36, 15, 1070, 1146, -24, -34, -37, -87, -10, -163, -18, -98], [-49, -119, -122, -20, -101, 1126, 1048, -63, -57, 1192, 1283, -94, -63, -35, -57, -58, -55, 412, -72], [140, 404, 9, -71, -325, 1976, 1119, 272, 35, 1118, 1358, -232, -130, -117, -83, 10, -479, -662, -246]], dtype=np.int16),
    2: np.array([[-59, 1957, 1867, -55, -108, -92, -106, -83, -272, 778, -263, -159, 709, -157, 36, 29, 94, -130, 110], [25, 1029, 1131, 37, -64, -172, -298, -175, -288, 1830, -259, 5, 1621, -141, 112, -3, 62, -466, 110], [69, 1711, 1696, 45, -99, -199, -193, -140, -514, 1430, -442, -233, 1062, -268, 105, 75, 186, -404, 209], [37, 1413, 1519, 61, -100, -28, -26, -55, -92, 842, -143, -119, 933, -153, 16, -31, 30, -14, 6], [-91, 2077, 1975, -119, -76, -68, -58, -67, -212, 598, -167, -179, 513, -129, 24, 37, 50, -54, 42], [-79, 2061, 2027, -59, -108, -52, -74, -79, -288, 710, -351, -207, 605, -213, 12, 57, 130, -138, 142], [-34, 1518, 1267, -33, -73, -56, -18, -24, -20, 876, -22, -119, 798, 18, -6, -3, 23, -37, 41], [20, 1962, 1887, 52, -161, -108, -126, -80, -480, 1134, -464, -260, 787, -304, 74, 72, 204, -297, 184], [137, 1165, 803, -3, -340, -4, -154, -167, -456, 1942, -23, -311, 1773, -93, 108, -79, 322, -434, -90], [29, 589, 579, 25, -84, 8, -290, -319, -76, 2854, -155, -7, 1885, 39, 436, 49, -10, -1458, 2], [-35, 1885, 1755, -119, 144, -220, -70, -39, -524, 1130, -247, -223, 917, -269, 52, 33, 34, -294, 186], [-103, 1869, 1835, -99, -68, -60, -66, -39, -128, 694, -143, -111, 653, -133, 20, 1, 18, -82, 38]], dtype=np.int16),
    3: np.array([[37, 979, 969, 68, -171, -266, -143, -217, 59, -243, 73, -61, 1860, 1898, -2, -32, -42, -134, -44, -102, -64, -151, -175], [62, 1652, 1542, 16, -272, -181, -119, -149, 92, -328, 114, 39, 1193, 1195, 12, -116, -140, -193, -217, 9, -107, -42, 34], [28, 595, 634, 10, -188, -165, -77, -106, 45, -102, 110, -123, 2025, 1992, -140, 5, -157, -68, -29, -20, 12, -129, -56], [12, 803, 810, -6, -108, -133, -93, -90, 45, 10, 78, -43, 1641, 1736, -60, -27, -141, -52, 35, -100, -36, -65, -120], [80, 1491, 1330, 62, -380, -457, -113, -170, 169, -362, 238, 13, 1741, 1856, 32, -71, -189, -172, -105, -196, -120, -253, -328], [-80, 1071, 286, 78, 4, -77, -53, -250, -19, -58, -26, -115, 1765, 2268, -268, 21, 47, -236, 63, -404, -240, 299, 20], [32, 919, 818, 34, -248, -217, -113, -162, 125, -154, 106, -127, 2105, 2064, -116, -95, -49, -28, -77, -140, -208, -257, -116], [48, 375, 278, 62, -276, -221, -237, -166, 69, -74, 62, -91, 1881, 1772, -124, -135, -133, -128, -149, 292, 312, 347, 332], [16, 939, 890, 30, -124, -29, -81, 26, -27, 14, 6, 45, 1469, 1532, -48, -3, -17, -16, -57, -60, -128, -101, -180], [248, 2931, 1926, -86, 20, 7, 51, 34, -3, -1302, -30, -47, 1305, 1140, -20, 225, 219, 12, -85, -728, -640, -649, -432], [92, 1491, 842, 26, -444, -181, 19, -314, -19, -438, 158, -27, 1769, 1672, 36, 229, -205, -292, 99, -164, -180, 31, -104], [-132, 643, 602, 26, 324, -133, 3, 166, -35, 362, 222, -235, 2121, 1848, -316, -43, -365, -4, -109, -564, 76, -225, -136]], dtype=np.int16),
}

FEATURES = (
    np.array([[[3150085, 24639, 14208, 6750, 129147, 341376, 107790, 0, 0], [3102097, 15045, 9679, 2687, 94779, 272158, 40152, 20730, 6020], [3156421, 11284, 5019, 2415, 69756, 287477, 14601, 20356, 0], [3355443, 0, 0, 0, 503316, 1342177, 0, 0, 0]], [[3118150, 23375, 14266, 5681, 321127, 498339, 107088, 0, 0], [3015621, 14120, 9557, 3816, 195515, 512128, 45704, 17710, 6061], [3092331, 9569, 4199, 3434, 139755, 314228, 21410, 21425, 39], [3355443, 0, 0, 0, 503316, 1342177, 0, 0, 0]], [[3983234, 22849, 13210, 3170, 640752, 587322, 103214, 0, 0], [3788124, 13748, 7162, 2449, 383298, 782048, 43675, 17631, 6507], [3821853, 7592, 2652, 268, 272005, 564333, 14648, 22561, 359], [3355443, 0, 0, 0, 503316, 1342177, 0, 0, 0]], [[4287511, 22747, 12600, 6069, 1131053, 579097, 91369, 0, 0], [4176965, 14275, 6897, 3281, 803522, 866081, 43860, 12267, 7519], [4171335, 8409, 3957, 0, 583460, 601411, 21839, 18800, 1474], [3355443, 0, 0, 0, 503316, 1342177, 0, 0, 0]]], dtype=np.int64),
    np.array([[[0, 20065, 10486, 5549, 284115, 421022, 118943, 0, 0], [0, 12075, 8118, 2693, 205559, 432050, 51625, 22055, 5148], [0, 8901, 4440, 2482, 162469, 448615, 19133, 20648, 0], [335544, 0, 0, 0, 503316, 1342177, 0, 0, 0]], [[0, 18566, 10530, 5035, 524039, 507488, 110029, 0, 0], [0, 10710, 7375, 3919, 330443, 635300, 56196, 17493, 5292], [0, 6537, 3185, 3995, 277350, 435575, 26826, 20507, 0], [335544, 0, 0, 0, 503316, 1342177, 0, 0, 0]], [[0, 17048, 10650, 4998, 851210, 486692, 94864, 0, 0], [0, 10010, 5785, 3805, 574554, 768213, 52461, 14826, 5602], [0, 4978, 2698, 2141, 495660, 608312, 21613, 18055, 1139], [335544, 0, 0, 0, 503316, 1342177, 0, 0, 0]], [[834725, 15807, 11232, 8215, 1204116, 373514, 72719, 0, 0], [10562, 9989, 6051, 4576, 921918, 721117, 44053, 8379, 7070], [15445, 5322, 4668, 2257, 721781, 498252, 24895, 13596, 3047], [335544, 0, 0, 0, 503316, 1342177, 0, 0, 0]]], dtype=np.int64),
)

_CODES = (
    "c-rk<2YVt%wxx47G#MnKM2;dfIn#-Z5GYJ`9KW|~ulHMfz1}wtGy3bVx)Bmt46Jt-4egonjHFA~y{D>fg;S>>Xx*d#poeyN_"
    "S)R~!TQOXyWhJ%S@Y2Q(5Gq+Cx1`EpQt&S`#pz#qUL1vw<`IGnrnn#1kDpRSFC+**MD2F?voK~`(4|LY+Lq!hxs4oJK-PvJn"
    "$3S7Jf%_OqcuX_d4ujT%Y+jq`$SS{_fH*%siIghL419?RRzWKHJ3{`|+>H*5(jg{jC9SZw_VOy}+QY3lD|<`4zsUIrt7_{rh"
    "*?k1~g*ijL?9|GYXz*0qZ@-+^Ft=cg~+Ak8SyEqsR{n*Z^Cg2=i?x$f-{Rs7p`48GPJTKaMF;6Rgn_QR`;7I|nIkJNc+x*I^"
    "K$n{^pDjGqPgIARRTJfnE1S3Rn_?K@u6Dk=)ALqODdfe0h?tdE&d<}9-d>?m{2x*RT&;RsNj9V!TzWap7+q+awd1OHt!`$<?"
    "pLbGDCAKnp(2BUjFs}F3uHSxno^h%$_^xBxq_=_O*TbmBSGxTAt6{;TLN_yqCjB;uy3P@<w68zE=~m+|J#jZcf>%|OxqcrZX"
    "xmx2ef{$JIhXY4$-7jefF|Kt<@?=haFr!gXkNa2G2~NT(_Qf&3*G(e5lm$c<{OtUUW|l{&#1!CscwDB18DLQQv+cb#Z^XEB+"
    "IrhE=N7Fob*{VB!)Z;jvqc?aTJYUgi>R2`eNByWAI|osAXe5r%9tEraxfyApAdP4#NnF;grT`_eRr2PHgoXO}>^(23<!wn#5"
    "29hS$Cs!EjQgF<M-{2$QP{?W?v>%`p+5%VN~1NE}1fmEhlRz5pL^pHS*7zGPA84M!JkE_dcW(oh&W>$hyQ-?+nbwkR;B^~bJ"
    "YB3t1bVz<@cN|~7d^hgIH_w;a|MGv%gj8qxyfmB)SonH=GY$obHQd5%Si(|sQ#vPgV8iWqTDV5gb@I;t=72w`!3T!cb=07>o"
    "sX^q{1HW&$!%KQQ9E8plN>xSB-usPuCgM8Q$&rKS>&t%QPR!yi_42gVeBvGB-T=7Q@~N2b^jJqz1pc&eN0%fyLa8;o!|95Id"
    "rz!p!fuOJN#Mx(o^Jner)K>|aZ;%<96LN=CRgSf?QVms<Wf=JiN&B%QN;QNzi+rBiyuHxYJ<ZUNmqo<#i%P(GG|`90d(~98G"
    "i3^$ERUOFpQ#98ne|Mh^2C6R%o?FuAF1ef*!kBr&a?00q*dV$?r3LwVdS$Qgh@CB=dEl-5s_BX-Io&*2onef@jU1$hZz3H+V"
    "v+(jB=yQ6^ievK-go>eW(4YVb!|Q0;Marrs;|e_SWe%kCV3rO;72n?G6P8m)e(-Q>%R-=SAdjqApfKWOjgaj@c{`XX|IqqK%"
    "2U!2KSS(fE_j<1&rsi@0lRgz#_i_R<q?EQHDZU%qn5e&holA>+?NKtIId%aGRE5_Xx1C64X0<?G8XL$7*^<Lo)%MRbI>LM_S"
    "VYCVK^U-{s6L_AliaeW(1U<*68Wji}a2r_2Ht@n+W<Tfea}SO<{Fz#_+Y$IS=;)cVQ!P#*ck9K-+P#UrTDO^V8$fD;AiLkyY"
    "zmz~vQZOQK}?4fHk(v0*6+*gUw&Ws2vm9qs#m=!4w{Y2W>QTN^4I>$7u<F;-)rFhCAjbFLhAwd1MUah54az2-vsxW=fJ1^G|"
    "dlu+E3E_z^DB*%@2Iqr)&Nx^J!P|)}%j>TP3sus}uf^`md(rt}R;deR&7pA^Y!bXj|VAO>*?pD5=>J_>Iihl?&&8IVZO!#6m"
    ">r-8Bg**1uy_h9d3xs~@lOc5<scwVC<qIuD`V>%YH>U|TU-rO>-aKYkG>)&+QV*>Qcae)IiJJ*daGaDGGcl|_P4eeu<IpI49"
    "WIh~vPF4sD3_W5^Ta+Wb6bt$QHrSAx?aWTTppKb)krNKYC+HY#Usyqm3I%~Xq`?{4pRwAo^c!67bZ*GVRFTVb)o3fJF)DF-l"
    "zQZV~wTJVKtG8E;eAuof(T{?DbMxtP+|y}cgizZe<?hX^XZ>2@WZHZdzG>f~X*#aj8ZCBiUOYc%lczdjY9Dh<QCj0WjN(eYJ"
    "-}3&qc29y3KOtP8=>&#o^NhGwFi6eI7X_?u4s<y3`e6LUx<5-wafT*d%qtyyE!Kj>`0Zybm~9LlvuIV?KHS@CJ}HQ>uHjBYW"
    "%u+UaYhaP11V1KUosG!_lC{=FZ#}t+X`*ucK`2A@1l5?63^G&SZ6mlDP^e@o5FNm^t&G9P8D}r-u9dEKla0P-@d@I8_n5gVA"
    "}jmWg_fbSlta%{#8x^L1Kk26YfQf}*uYPH%{jaBp^-d^Mjs^PL_UXqANfQ{q`+bEt#J;S{Yqb_3jn-e}MhtLccxVUYG>*ZIA"
    "VxD(TUqu4ldR<|!I@hZh8=;kYV=FIQ58?|FXE%J1Dl}nntM5A{2;@K+S9u7J}H5>Pzn6)ZW;#EE=+>yEDPAF-^(TO(_&lIXP"
    "PH6IMrI1aA{LW*&h9dE`1cbfh*G-RR!I+Swjm}UK3~id7eyhn9nUK@0o;fh1n2gW&em_oe@3&-2sC70^Bn6r~$Ja%^##VBvu"
    "=~WM0sTCJATtwzeQ)oR+4|kg6_N<GTC1BW@{Lxn+iCFy#&6ZC2n3xBfM*WP?)7+n>Le#3ods2^PISINI#XkLP82w{QUlJrY("
    "^E06H<Cd6cQP8cE-B5?R|O@EBS+?gwh@g=7ny*+wOGPOgvzxr8zvJn9Sau5Wnt$H-~}$jLH+QwanExmaSDPA}?n1)~H2^Vc7"
    "EX(oX^RDaUBqugjf_{T4{@tpcslYTykQ-1eDwara>Q6noyz4hwAkqR^LPcK3WDe4AdQHy8{Ke47K$>VW$J_XF+++z+@Pa6jO"
    "F;L{%XwEJm(;M0DR<_A9Qr)hrR(>`7E^}NShXcwhW^cMTCrsJ+H8+ohR#dpiCX9sgA{2{dqn>Y14yS+IC#osf~_MB2E{XW0-"
    "+W{=)-?=T{E-P3xe`&+pO1wf4*7&uFLEEXM0(-pmOLtpyV1{?!4b~D`*Xoo)>d`+hsfP_TXjAjMEOC1Mj~f@du5GM)J9={S("
    "=!*ku3@b;ci#N;{B#R-+;Mpc&x^l5m*2knElX<4-Piy>F24T$RndaOv)h)By?tVC&cFW4o8r+FnRk=IPxeGHL-zIeZwiKWv4"
    "d6!!~%1|oPYEEtDFJb6u9Y85vsH?&6jUqHW|ALLsoT<(29N=Mk!08@#^iXR?@1(Rt9giIcbWDuiw6I#LXnKY3LqU1Q=zGHeP"
    "@8N{kwab>>T?7hwdW^sacdd;RLVTT8g~6h1Tcy{8^57rK$mb<Sv|ck}#Nubyz}l-Pp#yin~74*(_9mQbnp{MEBw<;<=jrs=S"
    "Xm2BRJx0AFjT<*PibJHmXkCgZnXJW<>S+)c~sB~6uyuh_DM#DB&Ncin~m8{UZWD9!<8<$Y(jy-2Nt^>?FTp<a}X>zIF<pc5K"
    ";q@p+(8kkHmg|i!hg~jr=CLec^C~7PxwFNAQEC0c;0OcrtE*9)O^2O&8lTf#yc1_7X3H%L*r^RxcOafAvqH1e7T8iY5p>&(T"
    "Gd#va^_{&!paFjsrAP$$($2f?M8zwXA&Wg-K@P^IhnCXpt;v$7^&2lte#l9!Z$mTj9Muj54dawdKs&8&K$-hSthm7;*Ml0eE"
    "a;oE7Y^eu+L%Ckfh8In+?EnUZuu#5@bq}eqF!G=3-u}P9_#Ep(-gB%q4AK(}^FLch5(IMm?YKI}G%4fme7@4osF!w0dJj@q9"
    "D{=9!r9bX@Behh;Oo7i3Hi#0gSkaK}o*`So>QEF~kZBbg10L3gfChz5{iR<{trWM-ks=?y2d6;^Ea8(giBjs@ISqeeyG*gU^"
    "(LGF@N(t5MQ6PD<>Vzb@gtA!N6-C>sKc?;&)+$OMOuhk!)29nt--)gtO+w-Ydz~`{)B$e3tdV`Ji(&2F!VNgDd)TxZNKq6P;"
    "+k-))lFh_}0q?QVtRa+`)NjDZJ$HN&cj^5q-LX58E(6>zyJ9^X^?*7@Ed>r)XzeIQ(R!<UOvfGeglaD7KQ%7uoQ{8fUL043U"
    "9NSN#`&n<;VYohdS#i^dG$C2bf>O0*5OjzsnFpRrM0+{WxjWP)8b0WnD6A+sG%?%LGF;h?<$E|+{Sv97FQt3<SU@PcSW`$<8"
    "CwD12^r#l<XmdNam8dt=;86OXcgF&}cT;QZ5w_`<zEQjgpY%@22gM``%sVc!AymIDYK%Mwt?Lx!B+;g$xr9M|`Iit(ug=hfM"
    "pA%e^%+>GLRrLMgRL?+zrGRHfbPH)^>|_AKu8xou{nQjH^0x<V%0n#EoomVvYTV%e(L84TNEJs0!YWWCDAmw07bCZ#qwz42_"
    "l(d~dNQOTu3t|O_zpv!pJGbt8y(<n;PdW$!b<=VZAo>(hp)5)O2pd#jao0+30@|+QdP*{PJBuT5y!ElLdUyj;*IiF@cJ}a$K"
    "qH^Vcr$yMXx%P?^YMt5U2_@3SD$9#azFsY5lOYf|txCCwJ2DeC3?oRXxqCygOoinIuEACF*%T8Gy6r}qB(ZT<4Nuqk`<F|8<"
    "CIcuw4VeL`8t4I6iS6mDw#Y>czk2gNO)3BCPXiMqCTd;ag`iKmHs3ctESVU*b*AmG@E3Yh|}pl#&JlsD7UYe@2E+Y(dlRMTm"
    "w{_mIxBG&#6~Yb4&a8oIJ%0GgCTzK<g#BO8{K2C$QC0Ch9WF)dqs+K!c`OTXJtDAx~<JMqer`_J@O(L}<+>0tSr?yJCJ|`0x"
    "+v{!h?(8w0^wqjw<=MS;oLl1{tVMk$xyQJ|Ox9wAj4vm+2=vZXr5@d8_CYq?a!Z8b>k4V}=56?YyW_pC&aT@eiQG^EDta(R;"
    "ZDlaw!p;pM}vZ=GcsnJZ0hd1z)_mh4Hz8hYWDy33G>pbyjj&Jmv4ZfIWQc)%v^;nKDB_`#C={pV<TI>m^h8`xSOmS=#v{*LI"
    "a&RFQfR4Nn6t#PnCdnxg`f-cZTYbqANHX1itIg-*u47q;{H~XTrb@kV#0<t!iqaef&p?75^g))Wfqwo(M@g#2lLr3q&Lv>Lq"
    "?XkB(iL%ZJrXKKCZ7yjr9nA7X{hic%RYJtCJ|*W_wvh5zs(b<8-ZObmUgB>2!qy)l9a)E4AOhK%<{azb6l;QPx`z%wU#0zo|"
    "OVd<_5;l{eT+O8WIeqEoZ(Y$Z%j#R%3JNR3;JhYFrv6DxFY4py^8=mQAoQw>wa+c88;$P>aRfA$K(DHffbh#PjCIv*V$SG(J"
    "hX*=Fzg1<RKix7`$_Lj;b%@B#&Xy5Yleu0mnjVE3i+&3>=nX^LDr?$PNmFd36W4z0Z&1x6JpNHj)Qs@fV|_Iq5Rl=d9EwYUO"
    "Qh*{89PQXD|9U+tF&);0~j8$J`!fpk*DZB4}BQ{YJUR(`?Y{FNLYeGv07ZcwRkS66^i6gXuwnS5jtkCKRC83(<(y4IVZ=h%d"
    "qQ)R2YYI;(3_86(#g>P?7Dy6##uLehZ8j@ODj>-N^6|Aw&|A6N?VC}r8)TDiwacIKo@}xgA@9S2{CwmDX)42?_Xka`C`~4uj"
    "Gm?*=T#Ep|7jpiy4<?F0Hex|m<kbQV)C60S5Ex=;QZB9qg8XqjZzcTZ%oTX<a1j3lg!QMH(aG!NHTi)tPb*T*uIyau$~Tg2b"
    "~5N={I``GZO}1qc@4X{M4}m)$j3_5mEGKITNd*q^Zc}v`n+h7vaQ`&^&JnC3yqg{O{sj$a4yU)?Hr)uP;VdE{l#P#%13$@=7"
    "qD@J7!suX^HjChD~rLGC*6E)IN~1MUah54az2Kj41A{eb%c_XF;K#Ch01O22N;`LyT<bQklz=F>vAJ6Z2FpBBD_cQM~<I_^B"
    "~9~X(e=F{$2=l|1u+Fx7f4!lbE7Tuwr-<1$s{<XP-ITHEl8|0&Whvs~TcJQ6Z{KgX77hYNZwWZv_cgMFs8n?$CI=Xf5lHbk0"
    "4tHrY)c<|9i#hVcU!fg*kG;?AM2P+M64}Ar^zQRr__Vqo|AKALr$yM`nmZI8&b@nq?%;d$=dTHPOG2!qj{EoT^xKkwL4$3*8"
    ">--~Lq~}}e{M#hZO!q*Pv2N!XiMKAl=<PiAhMRtyOQY$Tz6mo<Cz~{*D}_Tfl=%5$1l$aSmFe&HD9V<3M1y$5C4;<wtBl{uj"
    "l{zZ9xNnwD03xSzYGY-(D3=I0CKOH-*-afl+nh=KHUzRzlu$|G2_qz;)Hx@Gox#V7`=23_YTb3sa%<KmTvbt%NrZ-Q-?y1R+"
    "cj_W7S*h;b{4P3TFFbBXWy7la|iK7ac~o3Sg$ble4l1-0G>E(Z+bI&bCrn=kumCyl`O)T+lrKc-T^sMcE?ef{+?=b=#qTEV4"
    ";=J+S@-CP(~TLY!m^;b8Ya>S{@$86>?fY6M=tTgXrJc%if!iCoLn-_z6%sC|utXM%Bnbk>xQOfAgHm_d49CFE11BJlQbnu}i"
    "g@>jo+!(F*X2i=^uSR^zrN5^_FSP1qEM^2Hb&g<$Z4a+6`$949HmQhddfU^{w^?NOskCNSkSTJ_?x58cs#%F-Mw1x&nDF0T>"
    "KZKsk2boadA>iq9(CAEXbHa!dTP2x<KRimO1tkYQ{h{!^G=g1r6L~dm{j`YaEIn$M{!DX<V_UC^WoL7RZj&ShQ+`s_Wxesc?"
    "LT$Ce?b2E0_e4Yc_jrku9Xc9-C34Bpz$<d#6Xez+i_ZBDKL0U@DFN@N&?sr9&WcB#zD>J=l94a%>KFiNmcn+1(+D8QE-iTS7"
    "h0L_JRV+yja}srJ6?+yqXkji;ehMFhC_8`X5kb);TSpWp9&8FDsqD2|h~&TMmsnS6x@?Y+s@K<K<qvra9^60Z%wzTu86;Ev+"
    "*F{wzZB6Ke<dtxOM^;q>P0()}%arj&}N65#dP6M%2zQT#^mMH5{2VGX9M!t9eenL9r(A;?!@ClMGvCW^%)f?@ObZ#P_2s(^3"
    "h0XSKiiP3u-r){E{6*%^1KhPHr#H%E%Qcqc8!THZXF-D>ANP6a@DxvCTz5A}yFZaBeS${f&vVUIx7%*<B_?3iDe(u(y8{PHm"
    "udG3_vu-;l-~$Stu=e&AaE?l@*F1#k*C6L8<@tDD2hVU>j==k>(f5a|Ho?=FiH?An?F_(TkT$_)8g|<pIJx4D599G|2!34V("
    "4M*2MqFH6@t+gk1rU@76gH-Rx4tIO9zu~yOUN)=j&jF^h;WRh9T%F>JlUPkuO_r3|bu5><Mf(;?N<q0>3*s{d9DR=l2s73JV"
    "0e&iws8&!5EjdM(cjwYbGa$*0iPpIF&{o)sz|(o=Q#%j&4v88*S74vgl}wbw1||GLeAUw7cw9dJM3e!%^J`%}XGkGl_g&-t`"
    "Fa!UW(`Lt^{<)NK8W{~!Sc9+8c;e6U1H5=DH*azP(h5y6(w2%0%+(okyx^?alx<8&zyY~Kf;?@SO=VGmQ?L%S*-~V_z?%J{$"
    "Kg4#y9edCI2kE$vo3AaJ<3nZ_W~1hP1KQsA|ExYO=q}2;_<s6(dwbviWBRmr#Deti0t_wCxuD1Sb>lUl=x-M=^oS7a%7^d|e"
    "jfO@=3#GQzK)hjh`(H@pzZoP$-MIJMg?t&JEBRBei|h;TLQn4`I>UU=F!j3PLQqjY4!boeC9#cy<|;>BJKIBAFuLua;r4Anf"
    "V$<DwTZx!<&o}nY$}+Q${Nhx&GUidHP-q>0^9{aec6U^ZiXdsK>W(enazBlEx5>9amm``#I;BSbv1?k~wNDzWDY_!AZbtBfP"
    "xE;u;qt-2CZAU|dtI%#ADjhUTk^gHYyJ<K^4eZN{oX;gvtFSY(CDAAykOsPN+J&pIhPg{_S93e-?iYY*oeS8uNx`LJC}q8|n"
    "Q=H|;ai4j6=i<G-Jub=g+ap$x`>^uc`o(4QN$7xHX*tvQ6{G3fVwFEL_4z2YaMscOy9$+fX(HEm;g$da8N_=zgKgN7<PjSqv"
    "JPl{r&ggQ~<MU^3vzo+EcnPucY3#q>@5D+(D}%!uNtd`ryWeW^<xI@)H0dOs)f3~_-7C*MxG(7vTYQO<&^x~xw%BaM1#n-~7"
    "2f;(cXS?hS*Y~b6-?wRd{dBkmBmcd=P>JNNtSr+E$I8suaoJtByDhpQf09>ka(4uu-mMWg$JKBziupLt&xOEnOp_5_ij_D=T"
    "lMd$&s`niJ?!by<^Z~X9qsu$Q4Regx+Y>6RW9^Th^nNfQO$F?!>I$QZG;It*73IjC-pqNdq$xzsqXSDwha}KdF5g`S1X3uzF"
    "+Js?Zr;bOjJPuiYSP2R<>}r-g;#F@IcZvU|g^Orgf|LX+pJMM=Zmex##;`zZR9aK9Ui-rsj1r+2+0kOV`UR;Sl$a>b;?t6Ub"
    "jz310G_$}LFxLRlPL{j-G$FVhmW4TH`9d$d+8WoPg2r@IR*?-(;b*T}AptQ%HWJzeYJDpCOFET!hMuox4ZVTD(eb{M<WAJSP"
    "Q7Wx!Ux>+9S%H^euht7GzxUXrR>LGBHFt$9nXg#XaNpy7Sm>_dlVBETjl^?8x8G`Xdu%Qqu_`qPs1S<DF#ZYg>+a8JW702^^"
    "3>-p*J>PFFMu51s1}P>pIeE|C_+O|fnT?LB}x-AREO>JW{V%T3l5z@2X8DayuZAQ@q^)}Y^C2X_A6qsT{$OlDQKGu3qJwA&7"
    "d(D4B7|2&4Fii!2N*x0rvy$2iy<1A8_A)KJAY8LGNr1?`DqdVvg=+j@+UOXqUGWJ2BjLyUZHB#dk5scPl);8>^GL)$L+V-l`"
    "yIm$$2SE4+FabM>utH*@VS{5tKeVJB+ht$CNiKQ6Yp_PeHA3j}Q|JSa(h+IK6wYlqN5o)6(&#5PYpxFN;%zPmnncPYH<LueQ"
    "C@Q2hc=D`o)U3?FHINRmz(GScn=IQsv?F$b<$@k3mbsmD4_nGaxN(jn;!tY>S{+-)4bke}5^m`fJUgi|8{>H-Fh7Opszll4%"
    "9c}#5L7=UDCpy1$2nbqJbJns&iSD~T@d#&k-P^nGE^ufoMyvEv<>3E@#8#1)cc+f8e!f0N9_3rFSh|MI59V7G9yVV6<HiJU6"
    "*{@_*Z;UNe3bdr79*lczWm`OLnCVj|7%#Xh${Z_hgV6}y4bA~StY~3{ES*xdT34HmC=_!z6=u|VLnZ*RC(Cfe}2t+rzoWhLa"
    "ED0rgtPJrK|q>&u>`wz4L1+sq<w=NPGFsw{L0=0{I9w@4W;ELILydUYCz>c!NqiCvb$|YFDQH;;R?!jBA<`I@z*cA~!p|HHq"
    "M~Gu3+e)ysDJbcW5VnAy*RR_yY?D0LKXy!!fei?J#1L;pB%_ad#zqgdnhH?PE)iM$W}k~+SGBM3ZK8a>Hc@9O1sx1RKvR7)7"
    "Cb9cket{_kbSFGB*esR;QC*6ic^GUQHxVY2&50ubY!=>Kym(P0Dm_tioFuZ*CbkS`o?kGXqfcc9z&pO4>k@9}oLNUjMN0#vG"
    "FoM?Ge2D_r9*izpTp{Uq80aO$$}wMI{)SqamU-+s%X6KJ(M3lxx34f)KniG4EfXVY<4GvP^@dl&E|-gWESg32JjK1V(zLMFm"
    "=miq*n?@ddwnx%v+1y1ubO%HeWitnMTVJDZM3=riL7-0d%G>v<$J)brm=A0I*J-BU$RN5^~bJ2JX7YxX1gh}<xDc<ameP_ya"
    "$VHUX+mTpZ7%56~5K&v_-CzKJ&Yd_0r|@b0jat!!_a)wva>*1m-8fRFQ9A40?@vHW_r=%o>86<pRqASk9|dn@&PZN$6Z$_M2"
    "=j<{k6v;76oBAIznD#7jcAH@axD`Gn7AP!ZTt*}ugL=p~I6jRjO2ad3GtXtLQeuU)4kmQ^~%JeM1m*pURG)}91&{NUNmxlm4"
    "qPYhb=?s;UEI4=Dr=PV_47meBJ4Kuk4D>ge#zFthn{4R@8ty}`!3_VY-aFj}Gl;kdRRSEZoP%WfEwXvHtw7g<A>jFA$4vp`{"
    "RcXzq-dMUOv^%W^Un`_zL9f%SRg&0(Y9cyyT0w!p1SmbOQJIaNXtvCEhl3`U%OnE<hglE090De$)b}JqbaBN`s&+^2aJnLPF"
    "GfAFo{dVpN^&Wo6j|WjODm<?V^=r@%=@FhSj{DUPUDz|y@J8N(A@P_f3noL7!Er^6;#?&qgJ{;eu2L~;mh1Ndx;8#5eRKOjb"
    "sIYdz&jK&-^E54NZZ#A&R-aauGNst+%-RGSNzCc0{fMa1Xex2F<v^&K3cmYPz!SpG3a5xO~x6f#pTM)!@pxR3akjoYHr+On3"
    "&k+3V*qT&dO=tf#?vffHMe7GEvq)A6&A%Vwliq*U=A1lghS1=Du|V-iP7ew4;zk2jdA@Xh`}tQJ#DJmmDcEoL3AL<wB_sr#-"
    "Hp6AnoYEP=PHcu>DZ*<OwZ4tD0pH07_pI>OMutdw$OXh5|*BQ3CYCaWmn&>6K$(rsD=}B=%X9iiq><px;-SgpjgDvGV36EJv"
    "VJI?JQDzc0ENP2@Pm{=xxYFQ@=GoTGbx$bg5|Mzzgeq}Zk{^>Ks~*;V(HY<*KCMb;vU@_wOmWPslynQ_2CG$3;}!?6q-BEk2"
    "5>jpJ%LyT)EYsQ)GqU>R6KBE(a`|6`Dz1C5|s2s04hOJD!tJb2xZCuc8ThfO(&UT;?xBi9T;Ju4^qP80RlZeFv4*KPSXZc$e"
    "KM%^1^wiQ>s)l{)E-zF&GRq1b$dr0K{>{Tw9sW&q}?+&*ZsgyK@e@n?lm(&?)DV#Qnf#GBTNr;z5>DNwS9pzI)#73Ltcu(1}"
    "qw)6Xj=xqVtnUk(HSfK(f3M>NR|M#BzQE9bLOpN=LF^xkUz4tjY}^}!j+Zt!^0T(^I5&WYthIOTAgY$T*yI(Sx0JB|S0%#J`"
    "z>gGAN)~MGwHqV^7twyz+DaNoXCgp&khp{Xw^N>M$ce;H{p(ctAk*^l=xm^0pccM3p6Ep-*S6FmXW5>S<3M44XV0FiHY-<Q|"
    "49F3gWIPmhnN=8tOV#Yb<s}J{0@cual5m|e`F2_qd*xiilF0@kMt2Ok9Nwi#ateG|j+@k4{HZeN={nt3ODH7V$DpIU%aDp0i"
    "rvFsp~;CtgixuCzIaI(3<qt#UMnQMU|32b@C0w@;i`!xlMK*NlLmJ%$6Y?V5{t!LF6npCU{F4Z&vcVr+U3xo@;h8f=H^v@By"
    "gvQBa*hSI6`<|b?*jNB&9JqLQ$qv<H5sLxmqR9`20GphQg%$3@N7b#B>OxbWMN+Pn!dQOiAqbn_Rt?PRBC|pG$R2)3}_(p?S"
    "OMofPSp)~(W~OXBeQyiv;g!Xa<$Bz9s|V#-GtZc^@+8Z1TYj74{iZCzjId#RG!Zq(610`tL((z=sEz~giQf`K8l&Kk((+r3`"
    "5-Q>AU(reVCU@|647OtPe!YJr!A*IQY<eJZ}yUkiYoA#L;8maq56;quoym}6+rzoc)KYH=mu$r*>(+Rg<L2b(JlhPywdRyOF"
    "wg3F;ypqoQif8H|zI;%6Kb@2Q1`;$vYbh6#Vd`KoU(K_HYBil<n1DeG8q-}RLDtQnNtcE6F+6wPzu?(=D(QD;Lwfxw$i<NEz"
    "EfIzCKL=c<3j&t)W2W~ZkIPkCn?7!2O{NtSc=vkIX$67hHv%3xUQH<ggj{mOa~s{hrRnJ1s$i@?$t$$Z??H?kUS>m3cYsmLF"
    "a<3jn2hqS70>miWzl~4$^H*%ao@xYU62c^yWDj)$vRkjHbug@ekj=mmm94B;FT$jc&446D#&?0(?!oN#vy=Ia<Uks{SS0OSb"
    "v&S&gY^R1_{v0XL;(nq9sKCzgcfc~dCK8|dbL7w=*`rO=qJF3(1z(Us3((nyD8kj*16rAdFRb9r^%yv)V?4zpT$;9VT}HV51"
    "fxF2vo;C{gUfcpXW1MUah|Mlko54Qu(1^"
)
# fmt: on

N_STEPS, N_FAMILIES = 3, 6  # of steps; those with each table of features


def family_of(step: int) -> int:
    """Return which frequencies a step starts from with the first table of features."""
    return 0 if step == 1 else 1 if step == 3 else 2


@cache
def default_codes() -> NDArray[np.uint8]:
    """Return the trained codes, shape (N_FAMILIES, contexts, symbols)."""
    codes = np.frombuffer(zlib.decompress(base64.b85decode(_CODES)), dtype=np.uint8)
    return codes.reshape(N_FAMILIES, 176, 63)
